"""How text from files is set in reports, in pictures and on the terminal."""
