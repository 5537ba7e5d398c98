"""What the user takes home: splats, twin.json, pictures, meshes, simulator files, scores and a report."""
