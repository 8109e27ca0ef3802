/** How garments are stepped, as bundles say (`DriverConfig` and `SolverConfig` of `smplxpp.cloth`, which have the units). */

export interface SolverNumbers {
  substep: number;
  contacts_every: number;
  own_margin: number;
  most_speed: number;
  most_stretch: number;
  gravity: number;
}

export interface Simulation {
  ramp: number;
  ramp_step: number;
  hold: number;
  longest_step: number;
  teleport: number;
  most_stretch: number;
  most_drawn: number;
  sliver: number;
  beside: number;
  drawn_margin: number;
  least_determinant: number;
  wander: number;
  floor: number | null;
  solver: SolverNumbers;
}

/** The numbers of bundles that were written before they held any. These are history: they change no more. */
export const UNTOLD: Simulation = {
  ramp: 0.7, ramp_step: 1 / 30, hold: 0.2, longest_step: 0.26, teleport: 12, most_stretch: 4, most_drawn: 1.5, sliver: 0.005,
  beside: 0.005, drawn_margin: 0.002, least_determinant: 0.2, wander: 4, floor: null,
  solver: { substep: 1 / 500, contacts_every: 8, own_margin: 0, most_speed: 8, most_stretch: 1.2, gravity: 9.81 },
};
