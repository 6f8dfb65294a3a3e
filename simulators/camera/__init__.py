"""A virtual bed camera: what a lens would see of the laser's bed, its marks, the sheet and what was burned into it."""
