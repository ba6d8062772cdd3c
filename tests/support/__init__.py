"""What several tests share: small data, plain twins, the command line, records."""
