"""Settings: composing, validating and building what they describe."""
