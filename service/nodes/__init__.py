"""The three nodes: each wires one room to the bus and knows nothing of what carries the messages."""
