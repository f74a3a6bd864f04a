"""Bytes of the wire to domain objects and back: what adapters, storage and commands share."""
