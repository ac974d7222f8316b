"""Thousands of instances of one character, in one draw per level of detail."""
