"""Real devices: a GRBL laser, a Modbus indentation rig, a camera. Bytes and registers, no geometry."""
