topological_dimension: dict[str, int]
