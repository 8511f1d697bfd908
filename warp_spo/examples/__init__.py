"""Small mechanisms, each of which shows one feature. Run one with ``python -m warp_spo.examples.fourbar``."""
