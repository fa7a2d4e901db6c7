"""Networks and their parts, as their authors compute them, under the names of their weights."""
