"""Tasks and their environments: definitions, construction, checks, and Fetch's fast step."""
