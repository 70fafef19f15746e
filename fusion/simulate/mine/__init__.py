"""A ray-cast mine, the sensors that fly through it, and the truth."""
