"""Draws that thresholds are set on; no test and no proof is judged by them."""
