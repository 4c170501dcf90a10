"""What is traced: shapes (built in, from files), what they are made of, and how light meets a facet."""
