"""Virtual devices, each with its own model of the hardware; reached over the wire only."""
