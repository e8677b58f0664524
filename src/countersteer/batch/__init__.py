"""Many cars at once: the engine, what varies, how many get round."""
