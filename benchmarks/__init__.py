"""Benchmarks: each is a module to run, and prints or writes its own table."""
