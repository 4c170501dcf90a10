"""Tables for other renderers: Mitsuba 3, C++, and parameters for the rest."""
