"""The gate for changes of the verdict: diagnoses recordings with known answers and compares two runs."""
