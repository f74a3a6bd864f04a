"""The home of `MappingSettings` in earlier versions, kept for scripts that import it from here."""
