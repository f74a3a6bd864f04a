"""The verbs of the command `potserver`, a module each."""
