"""Speed beside error."""
