"""Learning: from experience to a driver's numbers."""
