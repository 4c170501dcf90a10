"""Errors and times: experiments, accuracy, comparisons, charts."""
