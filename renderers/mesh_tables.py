"""Columns of the tables that the host fills and the mesh kernels read; all tables are flat, rows one after another."""

NEAR = 0.1  # metres; nothing nearer along the camera's z is seen

# One row an instance, int64. The first five are the mesh's, as in the atlas; NODE is -1 without a label; SEEN, whether
# it may be in the image, and CASTS, whether its shadow may be.
VERTEX, VERTICES, TRIANGLE, TRIANGLES, TEXTURE, NODE, SEMANTIC, SEEN, CASTS = range(9)
INTEGERS = 9

# One row an instance, float64: 3 x 4 matrices to pixels times depth (u z, v z, z) and to the shadow map (column, row,
# metres towards the sun); what a normal is multiplied by for the sun's cosine, and, an axis each, to turn it upright
# and unscaled; the tint.
TO_IMAGE, TO_MAP, TO_SUN, UNSCALE, TINT, REALS = 0, 12, 24, 27, 30, 33

# One row a scene, float64. RAY: the world's x, y and z along a pixel's ray for each metre of depth, each a constant
# and what a column and a row add; EYE: where the camera is; ON_MAP: column, row and metres towards the sun on the
# shadow map, each of the eye, and of the ray like RAY. Light is as the image shows it, exposure included.
RAY, EYE, FOCAL, CENTRE, GROUNDED, OFFSET = 0, 9, 12, 13, 15, 16
SUN, AMBIENT, SUN_UP, ZENITH, HORIZON, HAZE, SHADOWED, ON_MAP = 17, 18, 19, 20, 23, 26, 27, 28
NOISE, DEVELOPED, MATRIX, BIAS, SCENE = 40, 41, 42, 51, 52

# One row a node, int32 and float64: extent and pixels of the visible mask, pixels of the silhouette in the image;
# extent of the silhouette on an endless canvas.
BOX, PIXELS, WHOLE, RESULTS = 0, 4, 5, 6
EXTENT = 4
