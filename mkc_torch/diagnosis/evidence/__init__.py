"""Tests of evidence: what speaks for and against a finding, one test a file."""
