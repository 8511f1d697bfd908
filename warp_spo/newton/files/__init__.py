"""Robot files: URDF and USD by readers of this library, MJCF by MuJoCo."""
