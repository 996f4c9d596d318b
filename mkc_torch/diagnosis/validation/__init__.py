"""Validation of a corrected model on recordings that no fit has used."""
