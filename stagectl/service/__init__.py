"""The supervisor object as a service: a daemon with an API on a socket. The servo's process never imports it."""
