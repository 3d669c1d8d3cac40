"""Files read back for people: summary, page, verification, facts, exports."""
