"""The paper's six examples and eight tables: `python -m benchmarks.paper`."""
