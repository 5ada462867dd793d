"""Bodies from files: URDF, MJCF, BVH, and the shape of a bare skeleton."""
