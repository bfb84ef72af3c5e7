"""The ReduceM scene and its file: layout, writer, reader, validator."""
