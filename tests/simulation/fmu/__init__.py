"""Tests of FMUs, which they compile themselves."""
