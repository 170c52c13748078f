"""How fast the workflow trains, held to the plain recipe: gsplat's example trainer as users write it."""
