"""Pure functions: arrays in, arrays (or a NamedTuple of them) out. No I/O, no log, no settings, no Zenoh."""
