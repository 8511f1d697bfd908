"""Everything between a caller's array and a launch: kinds of arrays, memory, recording, the order of calls."""
