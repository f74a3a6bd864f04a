"""A scan becomes part of the map: sectors, atoms, transport, fusion; and edits of the map that are not scans."""
