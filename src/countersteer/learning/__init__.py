"""Learning of a driver's parameters from drives."""
