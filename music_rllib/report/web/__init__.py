"""What a report's page is made of: its template, style and scripts, and the data they draw."""
