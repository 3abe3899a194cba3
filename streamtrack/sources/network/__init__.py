"""Streams over the network, read by a process that can be killed."""
