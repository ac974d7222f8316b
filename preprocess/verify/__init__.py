"""The build's measurement of itself: what a folder draws, beside what the source file says (docs/verify.md)."""
