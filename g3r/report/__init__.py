"""What people look at: pictures of volumes."""
