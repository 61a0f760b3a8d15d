"""A data set's partitions as tasks: what each computes, who runs them, what is done already."""
