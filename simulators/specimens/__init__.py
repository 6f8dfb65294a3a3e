"""Virtual specimens: force as a function of depth and history."""
