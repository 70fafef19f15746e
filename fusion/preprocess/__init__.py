"""From a data set or a recording to fused frames, in chunks that any machine may do."""
