"""What an instrument can do, when it clicks, how it was measured, and whether it still is so."""
