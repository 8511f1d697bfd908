"""The implicit time step without contact."""
