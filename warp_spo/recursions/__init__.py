"""The recursions of multibody dynamics, written once on symbolic scalars."""
