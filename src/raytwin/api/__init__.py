"""What `import raytwin as rt` offers, one module a subject; `raytwin/__init__.py` lists the names and loads them lazily."""
