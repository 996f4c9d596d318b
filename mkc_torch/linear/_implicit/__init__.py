"""Derivatives of a fit by the implicit function theorem."""
