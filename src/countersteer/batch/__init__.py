"""Many cars at once: the engine, their random variation, and their success."""
