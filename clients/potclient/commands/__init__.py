"""The commands of `potclient`: a module a verb, each with `add(commands)` and `run(arguments)`."""
