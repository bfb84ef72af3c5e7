"""The command line of striptools."""
