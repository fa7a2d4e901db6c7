"""What is taken from the original network: its graph (``export``), with the batch as a symbol (``batch``), narrowed."""
