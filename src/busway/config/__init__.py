"""Values that configure components: validated once, frozen, knowing nothing of the components' insides."""
