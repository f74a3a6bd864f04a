"""Where maps survive a restart: journal, tiles and saved copies."""
