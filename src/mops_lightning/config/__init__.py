"""Settings: composing and validating them, and building the objects that they describe."""
