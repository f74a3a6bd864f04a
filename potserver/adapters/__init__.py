"""What touches Zenoh: clouds and questions in, receipts, answers and counters out."""
