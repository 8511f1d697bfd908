"""Every operation checked against the dense reference and timed; the table of the main job."""
