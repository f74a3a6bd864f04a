"""A name that scripts outside the project import; what it names lives in `potserver.mapping`."""
