"""`raytwin explore`: what one sees of a line (`ExplorerState` to `ExplorerView`), and the page that shows it."""
