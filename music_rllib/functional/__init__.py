"""Pure mathematics: the policy's density and Tsallis entropy, TAC's losses, MUSIC's bound."""
