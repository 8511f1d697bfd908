"""Small systems that show one thing each: ``python -m warp_spo.examples.fourbar``."""
