"""Training speed of the workflow, compared with the plain recipe: gsplat's example trainer as users run it."""
