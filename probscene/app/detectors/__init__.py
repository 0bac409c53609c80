"""``probscene train`` and ``probscene predict``: a detector that is kept, and what it finds in photographs."""
