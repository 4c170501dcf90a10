"""What a table is: its blocks, its bytes, and samples drawn from it."""
