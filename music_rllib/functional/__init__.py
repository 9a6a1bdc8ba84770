"""Pure maths: Tsallis entropies, the policy's density, TAC's losses, MUSIC's bound."""
