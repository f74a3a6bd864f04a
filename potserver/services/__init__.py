"""Use cases, callable from a notebook: integrate a scan, ask the map. No Zenoh, no bytes."""
