"""Logs to cars: windows of logs, the simulated car over them, and the fit of one to the other."""
