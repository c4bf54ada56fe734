"""The contract between nodes: topics, messages and their conversions, and the base class of every node."""
