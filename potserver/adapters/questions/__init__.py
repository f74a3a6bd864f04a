"""What a map is asked over Zenoh, one file a question: its message becomes a plan, and the plan's parts become replies."""
