"""Long-term storage of results as rows of one minute, which are later merged into rows of longer periods."""
