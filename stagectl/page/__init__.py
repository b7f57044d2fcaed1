"""The live page: a client of the service with a face, in a process of its own."""
