"""Which measurement next: designs from the information of candidates, and who can be told apart.

`design` knows matrices alone; `candidates` gets them from a model.
"""
