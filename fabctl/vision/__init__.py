"""Pictures to millimetres: markers, lens, bed alignment, kerf, inspection, engraved ids."""
