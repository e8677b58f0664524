"""The car: its parameters, each declared once, and the files that hold them."""
