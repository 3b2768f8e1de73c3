/** Whether the panel for driving by hand is open. */
class Drive {
  open = $state(false);
}

export const drive = new Drive();
