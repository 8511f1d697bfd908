"""The recursions as steps over abstract scalars, one file a recursion; a step is written once and traced."""
