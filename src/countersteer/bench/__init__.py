"""How fast it is, beside what it is compared to."""
