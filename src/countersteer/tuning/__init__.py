"""From logs to cars: windows of logs, their simulation, and the fit of a car to them."""
