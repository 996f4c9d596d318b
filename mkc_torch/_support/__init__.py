"""What knows no domain: checked arguments, files, order statistics, trust regions, forward mode, units in words."""
