"""What the answer should be: the exact sphere, and the validation of files."""
