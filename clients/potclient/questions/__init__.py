"""The questions of a client, a module each: build the message, ask over a `Link`, check and assemble the answer."""
