"""A glTF file as it is: its JSON, checked against the schema, and accessors read when asked for."""
