"""What a server tells over HTTP: a page with its maps, is it alive, is it ready, and its counters for Prometheus."""
