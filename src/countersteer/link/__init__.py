"""What lies between a driver and a car: rate, delay and loss."""
