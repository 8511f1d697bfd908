"""Elastic bodies: modes, beams, sections."""
