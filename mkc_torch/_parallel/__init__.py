"""Work shared by the cores of one machine."""
