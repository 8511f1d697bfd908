"""The scene as the recursions see it: links, serial segments, constants, and one symbolic evaluation."""
