"""What a server tells over HTTP, for those who operate it: is it alive, is it ready, and its counters for Prometheus."""
