"""One artifact for many robots that ask at once: copies on a Ray cluster behind one server with a lock."""
