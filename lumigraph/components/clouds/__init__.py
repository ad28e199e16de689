"""Parts of methods whose scene is a cloud of Gaussians; dense points and flat views of photographs."""
