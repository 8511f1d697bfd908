"""Contact of bodies with the ground inside the articulated-body recursion."""
