"""Contents of a finding: parameters, place, grade, advice and experiment design."""
