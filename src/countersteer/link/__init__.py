"""The link between a driver and a car: rate, delay and loss."""
