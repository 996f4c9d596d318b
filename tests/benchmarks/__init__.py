"""What is measured and not tested: times differ from machine to machine."""
