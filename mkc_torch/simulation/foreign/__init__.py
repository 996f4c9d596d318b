"""Simulations whose functions are not of torch: their values and derivatives as torch functions."""
