"""Pure geometry and mechanics: a target surface in, a cut sheet and its predicted behaviour out."""
