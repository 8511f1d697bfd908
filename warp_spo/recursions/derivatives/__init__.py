"""Derivatives of the recursions: dense Jacobians, and products with them."""
