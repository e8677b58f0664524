"""The speed of the simulator, beside that of MuJoCo."""
