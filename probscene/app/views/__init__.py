"""What a person looks at: reports, tables, pictures, scenes to turn."""
